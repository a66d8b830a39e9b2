from .comparison import Comparison, compare
from .datasets import DataPair, DataSet, open_data_set
from .differences import Differences, compare_shapes
from .protocols import Protocol, protocol_pairs

__all__ = [
    "Comparison",
    "DataPair",
    "DataSet",
    "Differences",
    "Protocol",
    "compare",
    "compare_shapes",
    "open_data_set",
    "protocol_pairs",
]
