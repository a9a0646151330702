"""File formats: text, tables, images, surfaces and meshes."""
