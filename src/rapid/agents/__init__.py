"""Agents: what drives, on disk, as ONNX, and how a name becomes one."""
