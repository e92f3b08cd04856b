"""Real recordings: recording files, track tables, image folders, a front end, a renderer, files for other tools.

What is read here was made elsewhere and is not trusted: nothing is unpickled, sizes are checked before memory is taken,
and a refusal names file, row, column and value. Needs the extra `images`, but for recording files.
"""
