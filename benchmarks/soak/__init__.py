"""Long runs: hours of table sessions in stepped time, and of motion in real time beside busy processors."""
