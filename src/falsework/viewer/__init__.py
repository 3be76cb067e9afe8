"""What people look at: pictures without a screen, and the page in the browser.

What is shown at a step is decided in modules that need no browser (`timeline`, `look`, `disruption`); `render`,
`sheet`, `drawing` and `film` turn it into files, `scene` and `page` into a page with viser.
"""
