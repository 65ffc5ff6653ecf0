"""The hardware interface of the loop: one Protocol, its implementation on boards, and angles from counts."""
