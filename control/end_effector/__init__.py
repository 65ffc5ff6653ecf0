"""What is at the end of the arm, under control: the gripper and the digital outputs."""
