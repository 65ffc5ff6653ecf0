"""Commands for the arms of a cell."""
