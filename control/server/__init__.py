"""The loop as a service: its process, the requests that it answers, and the client that sends them."""
