"""Pictures of what time series say."""
