"""A first arm.toml: from a few answers or another program's model, with motors that hold it; it runs on the mock at once."""
