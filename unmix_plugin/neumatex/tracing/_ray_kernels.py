"""The Warp kernel of rays against a triangle mesh: one work item is one ray."""

from typing import no_type_check

import warp as wp


@wp.kernel(enable_backward=False)
@no_type_check
def closest_kernel(
    first: int,
    end: int,
    stride: int,
    mesh: wp.uint64,
    longest: float,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    triangles: wp.array(dtype=wp.int64),
    barycentric: wp.array(dtype=wp.vec2f),
    distances: wp.array(dtype=float),
):
    for ray in range(first + wp.tid(), end, stride):
        query = wp.mesh_query_ray(mesh, origins[ray], directions[ray], longest)
        if query.result:
            triangles[ray] = wp.int64(query.face)
            barycentric[ray] = wp.vec2f(query.u, query.v)
            distances[ray] = query.t
        else:
            triangles[ray] = wp.int64(-1)
            barycentric[ray] = wp.vec2f(0.0, 0.0)
            distances[ray] = longest
