"""Methods held against each other, against OpenCV and against networks."""
