"""Ray casting of a triangle mesh over a ground plane: one thread per sample of the picture.

The host scales everything so that the scene has size one, with z up. Colours are linear light, 0 to 1.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

MAX_LAYERS = wp.constant(200)
"""Bound of the surfaces that a ray goes through: cut away, or transparent."""
PIXELS = wp.constant(64)
GRID = wp.constant(8)
"""Bit of `Scene.sides`."""


@wp.struct
class Scene:
    """Picture data: mesh, camera, light, ground plane and its shadow map."""

    mesh: wp.uint64  # id of a wp.Mesh: the surfaces
    corner_normals: wp.array(dtype=wp.vec3)  # [3 * face + corner]
    colors: wp.array(dtype=wp.vec3)  # [vertex]
    eye: wp.vec3  # position of the camera
    forward: wp.vec3  # unit vector of the viewing direction
    right: wp.vec3  # half the picture's width at distance one
    up: wp.vec3  # half its height
    principal_point: wp.vec2  # intersection of the axis `forward` with the picture, in [-1, 1]
    width_pixels: float
    height_pixels: float
    light_direction: wp.vec3  # towards the light
    ground_height: float  # height of the ground plane
    has_ground: int  # 1: draw the ground plane
    grid_spacing: float  # distance of the ground's fine lines; every fifth is strong
    fade_radius: float  # radius at which the ground has faded into the background
    ground_center: wp.vec2  # (x, y) of the middle of the ground
    shadow_map: wp.array2d(dtype=float)  # light (0 .. 1) that reaches the ground
    shadow_map_corner: wp.vec2  # corner of the shadow map
    shadow_cell_size: float  # size of its cells
    blocker: wp.uint64  # id of a wp.Mesh: the opaque surfaces, which cast shadows
    opacity: wp.array(dtype=float)  # [face] 0 .. 1; or empty, all opaque
    reference: wp.array(dtype=wp.vec3)  # [vertex] coordinates of the grids on surfaces; or empty
    # [face] bits 1, 2, 4: the side opposite its corner is an edge of an element; bit 8: drawn with a grid; or empty
    sides: wp.array(dtype=wp.int32)
    ghost: wp.uint64  # id of a wp.Mesh seen through, the undeformed surface
    has_ghost: int
    cut: wp.vec4  # direction and place of a section; nothing beyond it is drawn
    has_cut: int


@wp.func
def blend(a: wp.vec3, b: wp.vec3, t: float):
    """a (1 - t) + b t."""
    return a * (1.0 - t) + b * t


@wp.func
def background_color(height: float):
    """Colour of the background at a height in the picture, 0 at the bottom and 1 at the top."""
    return blend(wp.vec3(0.90, 0.91, 0.92), wp.vec3(0.60, 0.68, 0.78), wp.clamp(height, 0.0, 1.0))


@wp.func
def line_coverage(x: float, step: float, half_width: float, footprint: float):
    """Fraction of a pixel of size `footprint` at x covered by lines at the multiples of `step`."""
    d = wp.abs(x / step - wp.round(x / step)) * step
    w = wp.max(half_width, 0.5 * footprint)
    strength = half_width / w
    return strength * (1.0 - wp.smoothstep(w - 0.5 * footprint, w + 0.5 * footprint, d))


@wp.func
def ground_light(scene: Scene, x: float, y: float):
    """Light (0 to 1) that reaches a point of the ground: the shadow map, bilinear; 1 outside of it."""
    fx = (x - scene.shadow_map_corner[0]) / scene.shadow_cell_size - 0.5
    fy = (y - scene.shadow_map_corner[1]) / scene.shadow_cell_size - 0.5
    i = int(wp.floor(fx))
    j = int(wp.floor(fy))
    if i < 0 or j < 0 or i + 1 >= scene.shadow_map.shape[0] or j + 1 >= scene.shadow_map.shape[1]:
        return 1.0
    u = fx - float(i)
    v = fy - float(j)
    low = scene.shadow_map[i, j] * (1.0 - u) + scene.shadow_map[i + 1, j] * u
    high = scene.shadow_map[i, j + 1] * (1.0 - u) + scene.shadow_map[i + 1, j + 1] * u
    return low * (1.0 - v) + high * v


@wp.func
def shade_ground(scene: Scene, p: wp.vec3, distance: float, slope: float, behind: wp.vec3):
    """Colour of the ground at p: a light plane with a grid and the shadow, fading into the colour `behind` it."""
    base = wp.vec3(0.80, 0.81, 0.83)
    pixel = distance * wp.length(scene.up) * 2.0 / scene.height_pixels
    footprint = pixel / wp.max(slope, 0.05)
    step, big = scene.grid_spacing, 5.0 * scene.grid_spacing
    fine = wp.max(line_coverage(p[0], step, 0.4 * pixel, footprint), line_coverage(p[1], step, 0.4 * pixel, footprint))
    strong = wp.max(line_coverage(p[0], big, 0.7 * pixel, footprint), line_coverage(p[1], big, 0.7 * pixel, footprint))
    base = blend(base, wp.vec3(0.50, 0.53, 0.58), wp.max(0.45 * fine, 0.70 * strong))
    base = base * (0.48 + 0.52 * ground_light(scene, p[0], p[1]))
    r = wp.length(wp.vec2(p[0], p[1]) - scene.ground_center) / scene.fade_radius
    return blend(behind, base, wp.exp(-r * r * r))


@wp.func
def shade_surface(scene: Scene, p: wp.vec3, n: wp.vec3, flat: wp.vec3, albedo: wp.vec3, ray: wp.vec3):
    """Colour of a surface at p: light of sky and ground, a key light with shadow, a head light, a small highlight."""
    key = wp.max(wp.dot(n, scene.light_direction), 0.0)
    if key > 0.0:
        if wp.mesh_query_ray_anyhit(scene.blocker, p + flat * 1.0e-3, scene.light_direction, 10.0):
            key = 0.15 * key
    head = wp.max(-wp.dot(n, ray), 0.0)
    sky = 0.5 + 0.5 * n[2]
    half = wp.normalize(scene.light_direction - ray)
    shine = 0.07 * wp.pow(wp.max(wp.dot(n, half), 0.0), 40.0) * wp.min(key * 4.0, 1.0)
    light = 0.24 + 0.18 * sky + 0.46 * key + 0.26 * head
    return albedo * light + wp.vec3(shine, shine, shine)


@wp.func
def side_shade(scene: Scene, face: int, p: wp.vec3, distance: float):
    """Share of black of the edges of elements at a point of a face, lines of about 1.3 pixels."""
    shade = float(0.0)
    a = wp.mesh_get_point(scene.mesh, 3 * face)
    b = wp.mesh_get_point(scene.mesh, 3 * face + 1)
    c = wp.mesh_get_point(scene.mesh, 3 * face + 2)
    pixel = distance * wp.length(scene.up) * 2.0 / scene.height_pixels
    bits = scene.sides[face]
    for k in range(3):
        first, second = b, c
        if k == 1:
            first, second = c, a
        if k == 2:
            first, second = a, b
        if (bits >> k) & 1 == 1:
            along = wp.normalize(second - first)
            d = wp.length(wp.cross(p - first, along)) / pixel
            shade = wp.max(shade, 0.7 * (1.0 - wp.smoothstep(0.4, 0.9, d)))
    return shade


@wp.func
def grid_shade(scene: Scene, face: int, weights: wp.vec3, distance: float, facing: float):
    """Share of black of a grid fixed to a surface: lines at round coordinates of its reference points."""
    k = 3 * face
    a = scene.reference[wp.mesh_get_index(scene.mesh, k)]
    b = scene.reference[wp.mesh_get_index(scene.mesh, k + 1)]
    c = scene.reference[wp.mesh_get_index(scene.mesh, k + 2)]
    at = a * weights[0] + b * weights[1] + c * weights[2]
    n = wp.cross(b - a, c - a)
    x, y = at[1], at[2]  # the coordinates along the face
    if wp.abs(n[1]) > wp.abs(n[0]) and wp.abs(n[1]) >= wp.abs(n[2]):
        x, y = at[0], at[2]
    if wp.abs(n[2]) > wp.abs(n[0]) and wp.abs(n[2]) > wp.abs(n[1]):
        x, y = at[0], at[1]
    pixel = distance * wp.length(scene.up) * 2.0 / scene.height_pixels
    footprint = pixel / wp.max(facing, 0.1)
    step = 0.5 * scene.grid_spacing
    return 0.45 * wp.max(line_coverage(x, step, 0.6 * pixel, footprint), line_coverage(y, step, 0.6 * pixel, footprint))


@wp.func
def surface_color(scene: Scene, face: int, weights: wp.vec3, p: wp.vec3, distance: float, ray: wp.vec3):
    """Colour of the surface that a ray meets at p, with its lines; `weights` are of the corners of the face."""
    k = 3 * face
    n, albedo = wp.vec3(0.0), wp.vec3(0.0)
    for i in range(3):
        n += scene.corner_normals[k + i] * weights[i]
        albedo += scene.colors[wp.mesh_get_index(scene.mesh, k + i)] * weights[i]
    n = wp.normalize(n)
    flat = wp.mesh_eval_face_normal(scene.mesh, face)
    if wp.dot(flat, ray) > 0.0:
        flat = -flat
    if wp.dot(n, flat) < 0.0:
        n = -n
    color = shade_surface(scene, p, n, flat, albedo, ray)
    if scene.sides.shape[0] > 0:
        color = color * (1.0 - side_shade(scene, face, p, distance))
        if scene.sides[face] & GRID != 0:
            color = color * (1.0 - grid_shade(scene, face, weights, distance, -wp.dot(flat, ray)))
    return color


@wp.func
def meet_face(scene: Scene, face: int, ray: wp.vec3):
    """Weights of the corners of a face where a ray from the eye meets it."""
    a = wp.mesh_get_point(scene.mesh, 3 * face) - scene.eye
    b = wp.mesh_get_point(scene.mesh, 3 * face + 1) - scene.eye
    c = wp.mesh_get_point(scene.mesh, 3 * face + 2) - scene.eye
    volumes = wp.vec3(wp.dot(ray, wp.cross(b, c)), wp.dot(ray, wp.cross(c, a)), wp.dot(ray, wp.cross(a, b)))
    total = volumes[0] + volumes[1] + volumes[2]
    u, v = wp.clamp(volumes[0] / total, 0.0, 1.0), wp.clamp(volumes[1] / total, 0.0, 1.0)
    return wp.vec3(u, v, 1.0 - u - v)


@wp.func
def sample_color(scene: Scene, at: wp.vec2, first_known: bool, first: int):
    """Colour (linear light) of a place of the picture (pixels, y down); `first`, where known: the face that its ray
    meets before others, -1 for none."""
    x = 2.0 * at[0] / scene.width_pixels - 1.0 - scene.principal_point[0]
    y = 1.0 - 2.0 * at[1] / scene.height_pixels - scene.principal_point[1]
    ray = wp.normalize(scene.forward + scene.right * x + scene.up * y)
    color = background_color(1.0 - at[1] / scene.height_pixels)
    reach = float(1.0e4)
    if scene.has_ground == 1 and ray[2] < -1.0e-4:
        reach = (scene.ground_height - scene.eye[2]) / ray[2]
    behind = float(1.0)  # share of the light from behind the surfaces met so far
    seen = wp.vec3(0.0, 0.0, 0.0)
    depth = float(reach)
    start = float(0.0)
    for layer in range(MAX_LAYERS):
        if behind < 0.01:
            break
        face = wp.int32(-1)
        weights = wp.vec3(0.0)
        if layer == 0 and first_known:
            face = first
            if face >= 0:
                weights = meet_face(scene, face, ray)
                start = wp.dot(wp.mesh_eval_position(scene.mesh, face, weights[0], weights[1]) - scene.eye, ray)
        else:
            hit = wp.mesh_query_ray(scene.mesh, scene.eye + ray * start, ray, reach - start)
            if hit.result:
                face = hit.face
                weights = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
                start += hit.t
        if face < 0 or start > reach:
            break
        p = scene.eye + ray * start
        if scene.has_cut == 0 or p[0] * scene.cut[0] + p[1] * scene.cut[1] + p[2] * scene.cut[2] <= scene.cut[3]:
            share = behind
            if scene.opacity.shape[0] > 0:
                share = behind * scene.opacity[face]
            seen += share * surface_color(scene, face, weights, p, start, ray)
            behind -= share
            depth = wp.min(depth, start)
        start += 1.0e-5
    if reach < 1.0e4 and behind > 0.0:
        color = shade_ground(scene, scene.eye + ray * reach, reach, -ray[2], color)
    color = seen + behind * color
    if scene.has_ghost == 1:
        before = wp.mesh_query_ray(scene.ghost, scene.eye, ray, depth)
        if before.result:
            facing = wp.abs(wp.dot(wp.normalize(before.normal), ray))
            color = blend(color, wp.vec3(0.30, 0.34, 0.42) * (0.4 + 0.6 * facing), 0.35)
    return color


@wp.kernel
def cast_rays(
    scene: Scene,
    pixels: wp.array(dtype=wp.vec2i),  # column, row
    places: wp.array(dtype=wp.vec2),  # of the samples in each pixel, 0 .. 1
    faces: wp.array2d(dtype=wp.int32),  # [pixel, sample] first face met, -1 for none; or empty, not known
    out: wp.array(dtype=wp.vec3),
):
    """Mean colour (linear light) of the samples of each pixel; a thread takes PIXELS of them, as the scene is copied
    for each."""
    first_pixel = wp.tid() * PIXELS
    known = faces.shape[0] > 0
    for pixel in range(first_pixel, wp.min(first_pixel + PIXELS, pixels.shape[0])):
        corner = wp.vec2(float(pixels[pixel][0]), float(pixels[pixel][1]))
        color = wp.vec3(0.0)
        for k in range(places.shape[0]):
            first = wp.int32(-1)
            if known:
                first = faces[pixel, k]
            color += sample_color(scene, corner + places[k], known, first)
        out[pixel] = color / float(places.shape[0])


@wp.func
def side_of(a: wp.vec3d, b: wp.vec3d, area: wp.float64):
    """Coefficients of 1, x and y of the weight of a corner of a triangle, from its two others."""
    return wp.vec3d(a[0] * b[1] - a[1] * b[0], a[1] - b[1], b[0] - a[0]) / area


@wp.kernel
def rasterize(
    corners: wp.array(dtype=wp.vec3d),  # [vertex] x, y in cells; what grows towards the viewer
    triangles: wp.array2d(dtype=wp.int32),
    slots: wp.array2d(dtype=wp.int32),  # [row, column] first index of `faces` for a cell; -1: not asked for
    places: wp.array(dtype=wp.vec2d),  # of the samples in each cell, 0 .. 1
    nearest: wp.array2d(dtype=wp.float64),
    faces: wp.array2d(dtype=wp.int32),
):
    """Triangle next to the viewer in each sample; threads must run one after the other, as on the CPU."""
    face = wp.tid()
    a, b, c = corners[triangles[face, 0]], corners[triangles[face, 1]], corners[triangles[face, 2]]
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area == wp.float64(0.0):
        return
    low, high = wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c))
    size = wp.vec2d(wp.float64(slots.shape[1]), wp.float64(slots.shape[0]))
    zero, one, slack = wp.float64(0.0), wp.float64(1.0), wp.float64(-1.0e-7)
    first_row, last_row = int(wp.clamp(low[1], zero, size[1])), int(wp.clamp(high[1] + one, zero, size[1]))
    left, right = wp.clamp(low[0], zero, size[0]), wp.clamp(high[0] + one, zero, size[0])
    fa, fb, fc = side_of(b, c, area), side_of(c, a, area), side_of(a, b, area)
    near = fa * a[2] + fb * b[2] + fc * c[2]
    for row in range(first_row, last_row):
        first, last = left, right  # columns of the cells that the triangle meets in this row
        for side in range(3):
            f = fa
            if side == 1:
                f = fb
            if side == 2:
                f = fc
            most = f[0] + wp.max(f[2] * wp.float64(row), f[2] * wp.float64(row + 1)) - slack
            if f[1] > zero:
                first = wp.max(first, -most / f[1] - one)
            if f[1] < zero:
                last = wp.min(last, -most / f[1] + one)
        for column in range(int(first), int(last)):
            slot = slots[row, column]
            if slot >= 0:
                for k in range(places.shape[0]):
                    at = wp.vec3d(one, wp.float64(column) + places[k][0], wp.float64(row) + places[k][1])
                    if wp.dot(fa, at) >= slack and wp.dot(fb, at) >= slack and wp.dot(fc, at) >= slack:
                        z = wp.dot(near, at)
                        if z > nearest[slot, k]:
                            nearest[slot, k] = z
                            faces[slot, k] = face
