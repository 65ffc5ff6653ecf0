"""`armwright iso9283`: runs the test programmes of calib.iso9283 on an arm with camera and loads."""
