"""The quadratic programs and their solvers."""
