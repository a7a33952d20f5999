"""How the satellite is turned: rotations, the body with its wheels, and attitude control by magnetometer (ROM)."""
