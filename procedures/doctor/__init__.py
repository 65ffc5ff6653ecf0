"""The checks of `armwright doctor`: this machine, its ports and buses, the boards behind them, the quality of their signals."""
