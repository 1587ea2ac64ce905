"""Read MuJoCo models (MJCF) as scenes, and their rangefinders as sensors."""
