"""Torques of the arm: rigid body, friction and other effects, feed-forward, and gains from them."""
