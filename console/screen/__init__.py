"""The operator's console: a full-screen terminal program (Textual), a client of the runtime like any other.

It decides nothing: the dead man's switch, the limits and the stop are the runtime's. One process, one event loop, no threads;
what takes long (planning, a session) is a subcommand in a process of its own.
"""
