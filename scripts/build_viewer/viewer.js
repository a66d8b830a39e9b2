// Opens a page: a pair of bodies or a collection. build.mjs bundles this module and all others with three.js into
// jaxsmw/report/assets/viewer.js, which both pages embed.

if (document.getElementById("canvas-x")) import("./pair.js");
else import("./collection.js");
