"""Models of MuJoCo, .xml of MJCF, as scenes, and their rangefinders as sensors."""
