"""placeholder"""
def load_kernel():
    from esc_gym.fastsim import kernel
    return kernel
