"""The dataset side: finds inputs, opens images, spells output names, writes files."""
