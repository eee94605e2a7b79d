from ltsim.adjust.residual_space import VISIBLE, ResidualSpace, orthonormal

__all__ = ["VISIBLE", "ResidualSpace", "orthonormal"]
