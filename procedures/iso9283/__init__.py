"""`armwright iso9283`: puts arm, camera, loads and the test programmes of calib.iso9283 together."""
