"""The live viewer: a run in the browser, while it trains and after.

Rooms: rendering (the scene, when to render and how finely, what leaves the viewer), layers (what can be shown), panels
(the controls); the server (life cycle) and sessions (one a page). Layers and rendering know nothing of viser.
"""
