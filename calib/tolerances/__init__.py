"""What accuracy an arm will have that is made to given tolerances, before and after its calibration."""
