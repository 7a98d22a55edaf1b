#!/usr/bin/env bash
# Bundles what the exported page uses of three.js and three-mesh-bvh into one file of the package, with their licences.
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
target=$here/unmix_plugin/products/page/three.js
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init --yes >/dev/null
npm install --silent --no-audit --no-fund three@0.187.0 three-mesh-bvh@0.9.17 esbuild@0.28.2
cat >entry.js <<'JS'
import { Mesh } from "three";
import { acceleratedRaycast } from "three-mesh-bvh";
Mesh.prototype.raycast = acceleratedRaycast;
export {
  BufferAttribute, BufferGeometry, Color, Data3DTexture, DoubleSide, Group, HalfFloatType, Line, LineBasicMaterial,
  LinearFilter, Mesh, MeshBasicMaterial, PerspectiveCamera, Raycaster, RepeatWrapping, Scene, ShaderMaterial,
  SphereGeometry, Triangle, UnsignedByteType, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { MeshBVH } from "three-mesh-bvh";
JS
npx esbuild entry.js --bundle --minify --format=iife --global-name=Kit --legal-comments=none --outfile=bundle.js --log-level=warning
{
    for name in three three-mesh-bvh; do
        echo "/*! $name $(node -p "require('./node_modules/$name/package.json').version")"
        sed 's#\*/#* /#g' "node_modules/$name/LICENSE"
        echo "*/"
    done
    # A page holds this in a script element, which "</script" would end.
    sed 's#</script#<\\/script#g' bundle.js
} >"$target"
wc -c "$target"
