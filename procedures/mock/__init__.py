"""A mock arm with its runtime for any procedure, stepped in this process or in real time in others."""
