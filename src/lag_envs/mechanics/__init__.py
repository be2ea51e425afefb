"""From energies to equations of motion: exact algebra on recorded formulas, without SymPy."""
