"""3x3 convolutions that are fast on processors too."""
