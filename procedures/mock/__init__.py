"""A mock arm with its runtime, stepped in this process or in real time in others, for any procedure to run on."""
