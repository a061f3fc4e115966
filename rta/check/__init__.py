"""The backup laws, which satisfy every limit and end in a set that they never leave, and checks of their trajectory."""
