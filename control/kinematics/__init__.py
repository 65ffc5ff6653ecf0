"""Where the tip is and which joint angles take it somewhere; generated straight-line code and closed forms."""
