"""Names and options of the subcommands as data: nothing but argparse is needed to read it."""
