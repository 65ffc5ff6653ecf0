"""`armwright bringup`: joint by joint with the operator, from a draft of arm.toml to one that fits the real arm."""
