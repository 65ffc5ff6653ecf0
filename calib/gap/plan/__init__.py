"""What to record so that as many effects as possible can be named: poses, motions, their order, and what it is worth."""
