"""The limits by name, and the units of their h."""

# In the order of the paper's table of violations: only thrust changes the first seven, only torque the last six.
TRANSLATIONAL = (
    "collision",
    "dynamic_speed",
    "keep_in_zone",
    "passive_safety",
    "velocity_x",
    "velocity_y",
    "velocity_z",
)
ATTITUDE = (
    "attitude_exclusion",
    "temperature",
    "battery",
    "angular_velocity_x",
    "angular_velocity_y",
    "angular_velocity_z",
)
PAPERS = TRANSLATIONAL + ATTITUDE  # the limits that the check verifies
OWN: tuple[str, ...] = ()  # your own limits, those on thrust first (docs/guides/your_own_constraint.md)
CONSTRAINTS = PAPERS + OWN
UNITS = {  # of h, by limit
    **dict.fromkeys(("collision", "dynamic_speed", "keep_in_zone"), "m/s"),
    "passive_safety": "m",
    **{f"velocity_{axis}": "m^2/s^2" for axis in "xyz"},
    **{"attitude_exclusion": "rad", "temperature": "deg C", "battery": "kJ"},
    **{f"angular_velocity_{axis}": "rad^2/s^2" for axis in "xyz"},
}
