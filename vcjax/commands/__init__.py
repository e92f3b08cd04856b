"""The commands of `vcjax`: each a class whose fields are its options, and whose call does the work."""
