"""What is modelled: state, attitude, orbit, dynamics and their parameters."""
