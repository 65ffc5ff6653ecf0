"""What takes an operator through a job step by step: bring-up, tuning, sessions, recordings, verification, demos."""
