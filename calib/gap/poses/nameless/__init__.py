"""What moves without a name: shapes of joints, of the tip and of holding currents, as the blocks that compete with effects."""
