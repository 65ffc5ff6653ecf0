"""How the screen draws: rows of styled text, panels, plots and pictures in Braille dots."""
