"""The paper and our own experiments, as data and as a graph of cells."""
