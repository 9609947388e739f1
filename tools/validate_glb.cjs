// Run the Khronos glTF validator over GLB files; exits with 1 if any has errors or warnings.
//
//     npm install gltf-validator && node tools/validate_glb.cjs OUT/mesh.glb ...

const fs = require("fs");
const path = require("path");
// The package may lie beside the caller rather than beside this file.
const validator = require(require.resolve("gltf-validator", { paths: [process.cwd(), __dirname] }));

async function main(files) {
  let bad = files.length === 0;
  for (const file of files) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)));
    const { numErrors, numWarnings, numInfos, messages } = report.issues;
    const { totalVertexCount, totalTriangleCount, hasMorphTargets, hasTextures } = report.info;
    console.log(
      `${path.basename(file)}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos; ` +
        `${totalVertexCount} vertices, ${totalTriangleCount} triangles, ` +
        `morphs ${hasMorphTargets}, textures ${hasTextures}`
    );
    for (const message of messages) console.log(`  ${message.pointer}: ${message.message}`);
    bad = bad || numErrors + numWarnings > 0;
  }
  process.exit(bad ? 1 : 0);
}

main(process.argv.slice(2));
