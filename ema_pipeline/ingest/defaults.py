"""What is taken of a channel where test.toml does not state it: never that it is exact."""

CALIBRATION_STD = 0.02
"""Relative 1 σ of a sensitivity that is not stated: what calibration certificates of accelerometers and
modal hammers usually claim, 3 to 5 % at two sigma."""

TRANSVERSE = 0.03
"""Transverse sensitivity where none is stated, 1 σ: data sheets promise less than 3 to 5 %."""
