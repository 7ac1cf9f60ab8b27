"""What every task must hold, as checks: its maths, its physics, its protocols."""
