"""Prints the topics of an .mcap, as its own library reads it."""

import sys

from mcap.reader import make_reader

with open(sys.argv[1], "rb") as file:  # noqa: PTH123  # as its own examples have it
    topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
print("\n".join(sorted(topics)))
