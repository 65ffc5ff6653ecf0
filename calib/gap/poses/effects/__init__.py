"""The effects that poses can show, one file a family: laws in every channel, and how real parts depart from them."""
