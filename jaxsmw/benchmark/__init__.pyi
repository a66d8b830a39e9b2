from .datasets import DataPair, DataSet, open_data_set
from .protocols import Protocol, protocol_pairs

__all__ = ["DataPair", "DataSet", "Protocol", "open_data_set", "protocol_pairs"]
