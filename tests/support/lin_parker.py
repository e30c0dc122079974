"""A planetary gear with published frequencies."""

# J. Lin, R. G. Parker, J. Vib. Acoust. 121 (1999), the example gear and its table for N = 3.
LIN_PARKER = {
    "carrier_mass": 5.43,
    "ring_mass": 2.35,
    "sun_mass": 0.4,
    "planet_mass": 0.66,
    "carrier_inertia": 6.29,
    "ring_inertia": 3.00,
    "sun_inertia": 0.39,
    "planet_inertia": 0.61,
    "sun_planet_mesh_stiffness": 5e8,
    "ring_planet_mesh_stiffness": 5e8,
    "planet_bearing_stiffness": 1e8,
    "sun_bearing_stiffness": 1e8,
    "ring_bearing_stiffness": 1e8,
    "carrier_bearing_stiffness": 1e8,
    "ring_torsional_stiffness": 1e9,
    "carrier_torsional_stiffness": 0.0,
    "sun_torsional_stiffness": 0.0,
    "pressure_angle_deg": 24.6,
}
ROTATIONAL = [1475.7, 1930.3, 2658.3, 7462.8, 11775.3]
TRANSLATIONAL = [743.2, 1102.4, 1896.0, 2276.4, 6986.3, 9647.9]
