"""Tables, figures, texts and files of results."""
