// The names that viz/page/page.js takes from libraries.
export { ExtSplats, SparkRenderer, SplatMesh, utils } from "@sparkjsdev/spark";
export {
  HalfFloatType, PerspectiveCamera, Quaternion, Scene, ShaderMaterial, Vector3, WebGLRenderer,
  WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { FullScreenQuad } from "three/examples/jsm/postprocessing/Pass.js";
