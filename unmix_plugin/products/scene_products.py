"""What `unmix-export` offers of scenes of mixed materials: each product with its options.

The name of a product follows from that of its class. Help needs nothing else: its work is imported when asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from unmix_plugin.products.product import Job, Product, RunWork, ViewProduct


@dataclass(frozen=True)
class _ComparedProduct(Product):
    """A product in which known spectra stand beside the run's."""

    library: tuple[Path, ...] = ()
    """Known spectra to compare with in place of the built-in ones: .csv files, ENVI spectral libraries, texts of
    ECOSTRESS or USGS, or folders of them; +builtin adds the built-in ones."""


@dataclass(frozen=True)
class Abundances(ViewProduct):
    """Abundance of each endmember, summing to the opacity, 0 where nothing is: of each view VIEW.npy, (H, W, K)
    float32, and VIEW.png, a figure; on request ENVI and EXR images."""

    formats: tuple[Literal["npy", "png", "envi", "exr"], ...] = ("npy", "png")
    """npy, envi (.hdr and .img), exr (a channel for each endmember), png."""


@dataclass(frozen=True)
class Cubes(ViewProduct):
    """Spectral images: of each view radiance or reflectance on black, (H, W, bands) float32, 1 = full scale, as ENVI
    (VIEW.hdr and VIEW.img), spectral OpenEXR (VIEW.exr) or VIEW.npy."""

    formats: tuple[Literal["envi", "exr", "npy"], ...] = ("envi",)
    """envi, exr, npy (without wavelengths)."""


@dataclass(frozen=True)
class Endmembers(_ComparedProduct):
    """Spectra of the endmembers: endmembers.csv, the ENVI spectral library endmembers.hdr and .sli, a plot over
    wavelength, endmembers.png, and angles.csv, their angles to all known spectra."""

    compare: Literal["scale", "continuum"] = "scale"
    """How spectra are compared with known ones: by their shape, or after removal of the continuum."""


@dataclass(frozen=True)
class Mesh(Product):
    """The surface as triangles: mesh.ply, mesh.glb or mesh.obj with position and normal in the scene's world
    coordinates, colour, material and every abundance; GLB and OBJ with textures of them."""

    formats: tuple[Literal["ply", "glb", "obj"], ...] = ("ply", "glb")
    """ply, glb, obj (with mesh.mtl)."""
    resolution: int | None = None
    """Cells along the longest edge of the scene box; None: two for each pixel, from 32 to 256."""
    smoothing: float = 0.75
    """Blur of the distances to what cameras see: standard deviation in pixels, 0 for none."""
    unseen: Literal["drop", "keep"] = "drop"
    """What to do with surfaces that no camera of the run sees, and that were therefore never learnt."""
    up: Literal["y", "z"] = "y"
    """What is up in GLB and OBJ: y, as glTF prescribes and importers expect of both, or z: turned by nothing."""
    texture_size: int | None = None
    """Texels along the edges of textures in GLB and beside OBJ: colour, segmentation, abundances; None: as many as the
    surface needs, from 1024 on. 0: none, colours of vertices instead."""


@dataclass(frozen=True)
class Metamerism(_ComparedProduct):
    """Pairs of materials that look alike in one light and differ in another, as an eye adapted to each light sees them:
    metamerism.csv, the pairs with their differences, and metamerism.png, swatches."""

    library: tuple[Path, ...] = ()
    """Known spectra to pair in place of the built-in ones: .csv files, ENVI spectral libraries, texts of ECOSTRESS or
    USGS, or folders of them; +builtin adds the built-in ones."""
    surfaces: Literal["run", "library", "all"] = "all"
    """Pair the run's endmembers, materials of the library, or both together."""
    lights: tuple[str, ...] = ("D65", "A", "FL2", "FL11")
    """Lights to compare: CIE illuminants, lamps or .csv files (wavelength,power)."""
    alike: float = 2.0
    """Colour difference (CIEDE2000) up to which two materials look alike."""
    different: float = 4.0
    """Colour difference from which they look different."""


@dataclass(frozen=True)
class Page(_ComparedProduct):
    """One HTML file to mail to others, page.html: the surface in 3-D in any band, light, abundance or index; a click
    shows spectrum and mixture. It opens in a browser and needs no server, no network and no installation."""

    title: str = ""
    """Title of the page; the scene's name where none is given."""
    resolution: int = 256
    """Cells along the longest edge of the scene box; fewer where the page would have more than 600,000 triangles or
    exceed 20 MB."""


@dataclass(frozen=True)
class PointCloud(Product):
    """The surface as points: points.ply with position and normal in the scene's world coordinates, colour, material and
    every abundance of each point, with --spectra all bands, and with --outputs more numbers."""

    num_points: int = 100_000
    """Most points to write; they cover what the run's cameras see evenly."""
    spectra: Literal["none", "radiance", "reflectance"] = "none"
    """Whether each point has its diffuse spectrum, a number for each band."""
    formats: tuple[Literal["ply", "las", "laz"], ...] = ("ply",)
    """LAS and LAZ need the packages laspy and lazrs."""
    outputs: tuple[str, ...] = ()
    """Numbers to add to each point: spectral indices, targets, nearest known spectra and absorptions, as in index:ndvi
    target:ace:paint.csv library:angle:mine.csv absorption:centre:650-700."""


@dataclass(frozen=True)
class Poses(Product):
    """Cameras of all views as transforms.json and as a COLMAP model, with their pictures, in the world of the scene's
    poses; those of training views as training corrected them, where it did."""


@dataclass(frozen=True)
class Regions(Product):
    """Named parts of the surface, kept with the run: area, abundances, mean spectrum and its standard deviation of each
    of them and of each material (regions.csv, regions-spectra.csv, and the library regions.sli). With --add a region is
    kept, with --remove one is forgotten."""

    add: str | None = None
    """Name of a region to keep, which one of the next five options says."""
    box: tuple[str, str] | None = None
    """Two opposite corners of a box, in the world ("0.1 0.2 0.5") or by pixels of views (VIEW:column,row)."""
    material: str | None = None
    """Name or number of an endmember: where segmentations show it."""
    view: str | None = None
    """View of --polygon or --mask: its name, or its number among the evaluation views."""
    polygon: str | None = None
    """Corners in that view, column and row: "120,80 180,80 150,140"; what is seen inside."""
    mask: Path | None = None
    """Picture of that view's size: what is seen where it is white."""
    remove: str | None = None
    """Name of a region to forget."""


@dataclass(frozen=True)
class Report(_ComparedProduct):
    """One HTML file about the run, report.html, which needs nothing else: scene, views, materials with their nearest
    known ones, abundances, segmentation, figures of merit, errors, settings. Measured images and labels are
    shown where the scene folder is found."""

    max_views: int = 24
    """Most evaluation views to render; of more, an even choice."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    title: str | None = None
    """Heading of the report. It and the following are kept with the run; an empty text removes one."""
    author: str | None = None
    """Who made it."""
    object: str | None = None
    """What was imaged."""
    number: str | None = None
    """Its inventory number."""
    notes: str | None = None
    """What a reader should know of the object and its capture."""


@dataclass(frozen=True)
class Scale(RunWork):
    """How long things are: keeps with the run how long a unit of its world is, by two points and their distance, or
    says what is kept. What measures or exports lengths and areas then does so in metres, as maps do;
    depths of other views stay in units of the world."""

    name = "scale"

    points: tuple[str, str] | None = None
    """Two points on the object: in the world, as probes and exports give them ("0.1 0.2 0.5"), or by the pixel in
    which a view shows them (VIEW:column,row)."""
    distance: float | None = None
    """How far apart they are, metres."""
    metres_per_unit: float | None = None
    """Instead of points: the length of a unit of the world, such as 0.001 where poses are in millimetres."""

    def write(self, job: Job) -> list[Path]:
        """Find the points, set the scale."""
        return import_module("unmix_plugin.products.regions").set_scale(job, self)


@dataclass(frozen=True)
class Segmentation(ViewProduct):
    """Material of each pixel: labels/VIEW.png with ids and their palette (255: nothing), VIEW.npy with scores (H, W, K)
    float32, VIEW.png, a figure with a legend, and legend.csv, which names the ids."""


@dataclass(frozen=True)
class Spectrum(_ComparedProduct):
    """Spectrum of a pixel (--view 3 --pixel 120,80), of a point of space (--point=0.1,-0.2,0.5) or of a kept region
    (--region NAME, with its standard deviation): predicted, and measured where the scene folder is found, with the
    spread over training views, as CSV and plot; abundances and nearest known materials as JSON."""

    view: str | None = None
    """View of the pixel: its name, or its number among the evaluation views, from 0."""
    pixel: str | None = None
    """Column and row, from 0 at the top left, as in 120,80."""
    point: str | None = None
    """Point in the scene's world coordinates, as in 0.1,0.2,0.5."""
    region: str | None = None
    """Name of a region that is kept with the run (unmix-export regions)."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    compare: Literal["scale", "continuum"] = "scale"
    """How spectra are compared with known ones: by their shape, or after removal of the continuum."""


@dataclass(frozen=True)
class Splats(Product):
    """Gaussians fitted to what the run renders, for splat viewers: splats.glb (KHR_gaussian_splatting) and splats.ply,
    with material and every abundance of each."""

    formats: tuple[Literal["glb", "ply"], ...] = ("glb", "ply")
    """glb (up is +y), ply (up is -y, as viewers of splats expect)."""
    megabytes: float = 6.0
    """Size of splats.ply, in millions of bytes, at most."""
    steps: int = 1000
    """Of the fit; more are slower and nearer to what the run renders. 0: discs on the surface."""
    up: Literal["y", "z"] = "y"
    """z: axes stay those of the scene's world."""


@dataclass(frozen=True)
class Volume(Product):
    """Density and abundances on a regular grid: volume.npz with `density` (X, Y, Z), per world unit, `abundances`
    (X, Y, Z, K), the matrix `index_to_world`, and names and spectra of the endmembers."""

    resolution: int = 128
    """Cells along the longest edge of the scene box."""


PRODUCTS: tuple[RunWork, ...] = (
    Abundances(),
    Cubes(),
    Endmembers(),
    Mesh(),
    Metamerism(),
    Page(),
    PointCloud(),
    Poses(),
    Regions(),
    Report(),
    Scale(),
    Segmentation(),
    Spectrum(),
    Splats(),
    Volume(),
)
"""All that scenes of mixed materials have, and what runs of any method have, with the defaults of its options."""
