"""The loop as a service: its process, its requests, and the client."""
