"""Measured maps: what departs from its law or has no name, as smooth tables that the controller corrects."""
