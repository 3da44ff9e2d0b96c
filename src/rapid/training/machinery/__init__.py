"""What the trainers need beside their algorithms: worlds, records, optimisers, diagnostics."""
