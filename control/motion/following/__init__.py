"""From a path of the tip to motions of the joints: on a named branch (three joints), or near a reference posture (any arm)."""
