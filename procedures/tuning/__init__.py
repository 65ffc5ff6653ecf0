"""`armwright tune`: measures a joint's response, designs gains from it, and tests old and new gains on the arm."""
