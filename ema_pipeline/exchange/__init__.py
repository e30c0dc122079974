"""Results for other programs: universal files, CSV, SEP-005."""

from ema_pipeline.exchange.geometry import Geometry
from ema_pipeline.exchange.nodes import NodeTable, node_table
from ema_pipeline.exchange.sep005 import from_sep005, to_sep005
from ema_pipeline.exchange.tables import modes_table, shapes_table, write_frf_csv, write_table
from ema_pipeline.exchange.uff import write_uff

__all__ = [
    "Geometry",
    "NodeTable",
    "from_sep005",
    "modes_table",
    "node_table",
    "shapes_table",
    "to_sep005",
    "write_frf_csv",
    "write_table",
    "write_uff",
]
