"""What can be proven of an agent: decisions that no attack within a radius changes, or makes unsafe, and its return.

Importing this package imports nothing heavy.
"""
