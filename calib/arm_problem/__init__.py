"""The identification problem of an arm and its points: residuals with exact derivatives, references, effects behind encoders."""
