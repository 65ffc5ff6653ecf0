"""What `armwright doctor` looks at: this machine, its ports and buses, the boards behind them, what their signals are worth."""
