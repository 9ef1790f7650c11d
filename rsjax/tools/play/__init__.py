"""Steers the robot inside generated video, in a browser: ``rsjax play RUN`` (docs/play.md).

A message goes through ``server.py`` (HTTP) and ``connection.py`` (the WebSocket) → ``answers.py`` → ``session.py`` (a
tree of branches, ``tree.py``) → ``engine.py`` (one thread that generates the frames of all sessions).
"""
