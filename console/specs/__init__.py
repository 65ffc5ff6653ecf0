"""What each subcommand is called and which options it has, as data: nothing but argparse is needed to read it."""
