"""Robust statistics shared by the stages."""

MAD_TO_SIGMA = 1.4826  # 1/Φ⁻¹(¾): median absolute deviation → standard deviation of a normal distribution
BIWEIGHT = 4.685  # σ at which Tukey's biweight ends: 95 % as efficient as least squares (Holland & Welsch, 1977)
