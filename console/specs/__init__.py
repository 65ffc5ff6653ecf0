"""Names and options of the subcommands as data; needs only argparse."""
