"""Networks of photographs: our project, and the files of other programs."""
