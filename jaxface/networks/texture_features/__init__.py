"""The VGG-like extractor of texture features."""
