"""How a session moves the arm: its ports, clear paths, approaches, transfers."""
