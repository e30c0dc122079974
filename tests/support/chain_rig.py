"""Three masses in a row on springs, as a rig file."""

RIG = """
name = "chain"
modal_damping_ratio = 0.01
[parameters]
link = { value = 1e6, unit = "N/m", tolerance = 0.05 }
[[masses]]
at = "a.x"
value = 1.0
[[masses]]
at = "b.x"
value = 1.0
[[masses]]
at = "c.x"
value = 1.0
[[springs]]
name = "foot"
at = "a.x"
value = "link"
[[springs]]
name = "middle"
between = ["a.x", "b.x"]
value = "link"
[[springs]]
name = "top"
between = ["b.x", "c.x"]
value = "link"
"""
