"""The console's colours: one accent and two for warnings. Everything uses them through style.tcss."""

from textual.theme import Theme

ACCENT = "#3fc1b0"
THEME = Theme(
    name="armwright",
    primary=ACCENT,
    accent=ACCENT,
    warning="#e8b04b",
    error="#e5534b",
    success=ACCENT,
    foreground="#d5dbe3",
    background="#0d1218",
    surface="#141b23",
    panel="#1d2731",
    variables={"muted": "#8593a3", "frame": "#344250"},
)
