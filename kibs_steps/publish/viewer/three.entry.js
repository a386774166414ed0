export { WebGLRenderer, Scene, PerspectiveCamera, Color, BufferGeometry, BufferAttribute, Mesh, MeshLambertMaterial, MeshBasicMaterial, DirectionalLight, HemisphereLight, Vector3, Vector2, Raycaster, LineSegments, LineBasicMaterial, CanvasTexture, SRGBColorSpace, DoubleSide, Fog } from 'three';
export { MapControls } from 'three/examples/jsm/controls/MapControls.js';
