"""Static poses: which effects move the tip where the geometry says that it is not."""
