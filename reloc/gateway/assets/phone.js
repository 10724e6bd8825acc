// A photo of the camera, or of a file, goes to the gateway with the device's position; its pose comes back.

const $ = (id) => document.getElementById(id);
const POSITION_MS = 5000; // a fix that takes longer is not waited for
const LEAST_SIGMA_M = 10; // phones between houses are off by tens of metres and claim three
const MOST_SIGMA_M = 1e6; // of the wire

async function startCamera() {
  try {
    const video = { facingMode: "environment", width: { ideal: 1920 }, height: { ideal: 1440 } };
    $("camera").srcObject = await navigator.mediaDevices.getUserMedia({ video });
    await $("camera").play();
    show("camera");
    $("ask").disabled = false;
    say("Point the camera at what the map shows.");
  } catch (error) {
    // Browsers give the camera to pages over HTTPS and of this machine only; a file goes everywhere.
    say(`No camera here (${error.name}). Choose a photo.`);
  }
}

function show(which) {
  for (const id of ["camera", "shot"]) $(id).hidden = id !== which;
}

function say(text, state = "") {
  $("message").textContent = text;
  document.body.dataset.state = state;
}

function draw(picture, width, height) {
  Object.assign($("shot"), { width, height });
  $("shot").getContext("2d").drawImage(picture, 0, 0, width, height);
  show("shot");
}

async function snap() {
  if ($("camera").hidden) {
    show("camera"); // the photo before made room for the camera
    $("ask").textContent = "Where am I?";
    $("pose").hidden = true;
    return say("Point the camera at what the map shows.");
  }
  $("ask").disabled = true; // until the answer is there
  draw($("camera"), $("camera").videoWidth, $("camera").videoHeight);
  const photo = await new Promise((done) => $("shot").toBlob(done, "image/jpeg", 0.92));
  return ask(photo, await prior());
}

async function chosen() {
  const [file] = $("file").files;
  if (!file) return;
  $("file").value = ""; // the same file may be chosen again
  try {
    // As stored: the answer's pixels are those of the file, which is not turned.
    const picture = await createImageBitmap(file, { imageOrientation: "none" });
    draw(picture, picture.width, picture.height);
  } catch {
    $("shot").hidden = true; // HEIC, which the server reads and this browser does not
  }
  await ask(file, null); // where the device is now says nothing of where the photo was taken
}

async function prior() {
  if (!$("position").checked || !navigator.geolocation) return null;
  const options = { enableHighAccuracy: true, timeout: POSITION_MS, maximumAge: 10000 };
  const found = await new Promise((done) =>
    navigator.geolocation.getCurrentPosition(done, () => done(null), options));
  if (found === null) return null;
  const { latitude, longitude, accuracy } = found.coords;
  return { lat: latitude, lon: longitude, sigma_m: Math.min(MOST_SIGMA_M, Math.max(LEAST_SIGMA_M, accuracy)) };
}

async function ask(photo, place) {
  const form = new FormData();
  form.append("image", photo, "photo");
  form.append("options", JSON.stringify({ inliers: true }));
  if (place !== null) form.append("prior", JSON.stringify(place));
  $("ask").disabled = true;
  $("pose").hidden = true;
  say("Asking …", "asking");
  try {
    const response = await fetch("localise", { method: "POST", body: form });
    const reply = await response.json();
    if (!response.ok) say(`${reply.code}: ${reply.message}`, "refused");
    else if (reply.position === null) say(`Not localised: ${reply.reason ?? reply.status}. ${reply.detail}`, "unknown");
    else answer(reply);
  } catch (error) {
    say(`No answer: ${error.message}`, "refused");
  } finally {
    $("ask").disabled = $("camera").srcObject === null;
    if ($("camera").hidden) $("ask").textContent = "Camera";
  }
}

function answer(reply) {
  const { lat, lon, h } = reply.position;
  const [heading, pitch] = directions(reply.quaternion);
  const { horizontal_68_m: across, vertical_68_m: up, orientation_68_deg: turned } = reply.accuracy;
  const rows = {
    "Latitude": `${lat.toFixed(7)}°`,
    "Longitude": `${lon.toFixed(7)}°`,
    "Height": `${h.toFixed(2)} m (${reply.height_datum})`,
    "UTM": `EPSG:${reply.utm.epsg} ${reply.utm.easting.toFixed(2)} E, ${reply.utm.northing.toFixed(2)} N`,
    "Looks": `${heading.toFixed(1)}° from north, ${pitch.toFixed(1)}° up`,
    "68 % within": `${across.toFixed(2)} m, height ${up.toFixed(2)} m, ${turned.toFixed(2)}°`,
    "Map": reply.maps.join(", "),
  };
  $("pose").replaceChildren(...Object.entries(rows).flatMap(([name, value]) => {
    const parts = [document.createElement("dt"), document.createElement("dd")];
    parts[0].textContent = name;
    parts[1].textContent = value;
    return parts;
  }));
  $("pose").hidden = false;
  const points = reply.inlier_points?.pixels ?? [];
  mark(points);
  say(`Found: ${reply.inliers} map points agree, confidence ${reply.confidence.toFixed(2)}.`, "found");
}

// Heading clockwise from north and pitch up from level, degrees; the quaternion turns x forward into east-north-up.
function directions({ x, y, z, w }) {
  const east = 1 - 2 * (y * y + z * z), north = 2 * (x * y + w * z), up = 2 * (x * z - w * y);
  const degrees = 180 / Math.PI;
  return [(Math.atan2(east, north) * degrees + 360) % 360, Math.asin(Math.max(-1, Math.min(1, up))) * degrees];
}

function mark(pixels) {
  const canvas = $("shot"), pen = canvas.getContext("2d"), radius = Math.max(3, canvas.width / 150);
  pen.strokeStyle = "#20e060";
  pen.lineWidth = radius / 2.5;
  for (const [x, y] of pixels) {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.stroke();
  }
}

$("ask").addEventListener("click", snap);
$("file").addEventListener("change", chosen);
startCamera();
