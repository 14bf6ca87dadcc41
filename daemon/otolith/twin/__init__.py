"""What a machine is: its equations, and the compiled kernels that simulate them."""
