"""The fourteen performance characteristics of ISO 9283:1998 from recorded poses and paths.

Counted as the standard's scope lists them: pose accuracy and repeatability; multi-directional pose accuracy
variation; distance accuracy and repeatability; position stabilization time; position overshoot; drift of pose
characteristics; exchangeability; path accuracy and repeatability; path accuracy on reorientation; cornering
deviations; path velocity characteristics; minimum posing time; static compliance; weaving deviations.

The formulas are pure functions of arrays (pose, settling, path, velocity, cornering, load, weaving); the test
programmes are data (cube, programme); `evaluation` puts recorded data into the formulas.
"""
