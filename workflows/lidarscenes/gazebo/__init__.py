"""Read Gazebo worlds and models in SDFormat."""
