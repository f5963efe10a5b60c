"""Scene files: what they may say (`schema`), how they are read (`load`) and how they become tensors
(`build`).
"""
