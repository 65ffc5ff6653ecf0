"""Static poses as the gap workflow sees them: candidates, loads, shapes without a name, noise floor."""
