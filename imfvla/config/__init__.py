"""What a config says and may name: options of several packages, registered classes, files beside the package."""
