// node validate.js FILE.glb -> the Khronos validator's report as JSON on stdout
const fs = require('fs');
const validator = require('gltf-validator');

const file = process.argv[2];
validator
  .validateBytes(new Uint8Array(fs.readFileSync(file)), { uri: file })
  .then((report) => console.log(JSON.stringify(report)));
