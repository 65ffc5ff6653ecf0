"""What an arm.toml promises: reach, torques and payload, loads of the buses, and what is missing for what."""
