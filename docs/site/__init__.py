"""What writes the generated pages of the documentation: from the models, the commands and the doors."""
