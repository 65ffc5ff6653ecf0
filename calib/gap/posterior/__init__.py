"""One posterior over sets of effects: what a real arm lacks, its laws only roughly right, many effects at once."""
