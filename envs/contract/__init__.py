"""The contract of tasks, as checks: of their maths, their physics, their interfaces."""
