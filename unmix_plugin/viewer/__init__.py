"""The live viewer: a run in the browser, while it trains and after.

Rooms: layers (what can be shown), panels (the controls), the render loop (when to render and how finely), the server
(life cycle). Only `server`, `session`, `scene_objects` and the panels know viser; everything else is tested without it.
"""
