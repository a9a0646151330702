"""Makes the stand-ins beside it importable from every folder of tests."""
