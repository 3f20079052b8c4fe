"""What the viewers share, so that a run looks the same in all of them.

`selection` chooses the images that are shown, `measurements` knows what can be plotted, `encoding`
makes JPEG and PNG, `paths` cuts paths into pieces and places estimates in the world, `appearance`
has colours, shapes and the words for the log. The ROS 2 bridge and the recorder use the encodings,
too.
"""
