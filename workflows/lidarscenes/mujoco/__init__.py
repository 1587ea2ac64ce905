"""Read MuJoCo models (MJCF) as scenes, and rangefinders as sensors."""
