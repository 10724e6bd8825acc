/** Where the page's values come from: the server, or the page itself where it is one file. */

const inside = (id) => document.getElementById(id);
const inOneFile = inside("scene") !== null;
/** @type {{shown: Object<string, string>, missing: Object<string, string>}} */
const embedded = inOneFile ? JSON.parse(inside("pictures").textContent) : { shown: {}, missing: {} };

/** The document that `reloc/viewer/scene.py` describes. */
export async function loadScene() {
  if (inOneFile) return JSON.parse(inside("scene").textContent);
  return (await answered(fetch("/api/scene"))).json();
}

/** Points of all maps and scans of a place. @param {number} place @returns {Promise<ArrayBuffer>} */
export async function loadPoints(place) {
  if (inOneFile) {
    const text = atob(inside(`points-${place}`).textContent);
    return Uint8Array.from(text, (c) => c.charCodeAt(0)).buffer;
  }
  return (await answered(fetch(`/api/points/${place}`))).arrayBuffer();
}

/** A picture's address, or why there is none. @returns {Promise<{url: ?string, reason: string}>} */
export async function picture(mapId, imageId) {
  if (inOneFile) {
    const key = `${imageId} ${mapId}`;
    return { url: embedded.shown[key] ?? null, reason: embedded.missing[key] ?? "" };
  }
  const asked = new URLSearchParams({ map: mapId, image: String(imageId) });
  try {
    const response = await answered(fetch(`/api/picture?${asked}`));
    return { url: URL.createObjectURL(await response.blob()), reason: "" };
  } catch (error) {
    return { url: null, reason: error.message };
  }
}

/** The server's answer to a photo. @param {Blob} photo @param {boolean} exifPrior */
export async function ask(photo, exifPrior) {
  const headers = { "Content-Type": "application/octet-stream" };
  const call = fetch(`/api/query?exif_prior=${exifPrior}`, { method: "POST", headers, body: photo });
  return (await answered(call)).json();
}

/** UTM and geographic coordinates of a spot, or null where the page has no server to ask. */
export async function where(place, [east, north, up]) {
  if (inOneFile) return null;
  const asked = new URLSearchParams({ place, east, north, up });
  return (await answered(fetch(`/api/where?${asked}`))).json();
}

/** @param {Promise<Response>} call @returns {Promise<Response>} */
async function answered(call) {
  const response = await call;
  if (response.ok) return response;
  const told = await response.json().catch(() => ({}));
  throw new Error(told.message ?? told.detail ?? `the server answers ${response.status}`);
}
