"""The operator's console: a full-screen terminal program (Textual), and an ordinary client of the runtime.

The dead man's switch, the limits and the stop are in the runtime. One process, one event loop, no threads;
long tasks (planning, a session) are subcommands in separate processes.
"""
