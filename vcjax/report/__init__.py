"""Tables and figures made from the results of Monte-Carlo runs."""
