"""A short check of a calibrated arm: is it as it was, does it need a calibration, or is something wrong with a joint?"""
