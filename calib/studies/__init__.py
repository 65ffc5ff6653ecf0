"""Many independent tasks, such as the arms of a Monte Carlo study: one interface, whatever runs them."""
