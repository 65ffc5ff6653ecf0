"""Drawing on the screen: rows of styled text, panels, plots and pictures in Braille dots."""
