"""An arm and its points as a problem: residuals with exact derivatives, references, effects behind the encoders."""
