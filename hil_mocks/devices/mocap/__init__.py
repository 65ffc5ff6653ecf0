"""Mock motion capture systems, written from the vendors' descriptions and held to other people's clients."""
