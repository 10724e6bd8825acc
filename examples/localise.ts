// Where was a photo taken? A client of `featuredb gateway` for browsers, Node, Deno and Bun. It needs no package, and
// no build where types are stripped (Node from 22.18):
//
//     node examples/localise.ts http://127.0.0.1:8080 photo.jpg

export type Prior = { lat: number; lon: number; sigma_m: number; h?: number; sigma_vertical_m?: number };

// COLMAP's models; sigmas: how well the parameters are known, null or missing: exactly.
export type Camera = { model: string; width: number; height: number; params: number[]; sigmas?: number[] | null };

// docs/wire.md and schemas/wire/localise_reply.json have every field; these are what most programs ask for.
export type Reply = {
  status: "localised" | "localised_in_map" | "not_localised";
  reason: string | null;
  detail: string;
  position: { lat: number; lon: number; h: number } | null; // WGS84 degrees, metres in height_datum
  height_datum: string | null;
  quaternion: { x: number; y: number; z: number; w: number } | null; // x forward, y left, z up into east, north, up
  utm: { epsg: number; easting: number; northing: number; height: number; cam_from_utm_xyzw: number[] } | null;
  covariance: number[][] | null; // rotation (rad) before position (m), along east, north, up
  accuracy: { horizontal_68_m: number; vertical_68_m: number; orientation_68_deg: number } | null;
  confidence: number;
  maps: string[];
  inliers: number;
  inlier_points: { pixels: number[][]; utm: number[][]; map_rows: number[] } | null;
  request_id: string;
};

export class GatewayError extends Error {
  readonly code: string; // BAD_IMAGE, TOO_LARGE, BUSY, NO_SERVER ... (docs/gateway.md)
  readonly retryAfterS: number | null;

  constructor(code: string, message: string, retryAfterS: number | null) {
    super(`${code}: ${message}`);
    this.code = code;
    this.retryAfterS = retryAfterS;
  }
}

// A photo that shows no known place is an answer, with a reason. Throws GatewayError where there is none.
export async function localise(
  gateway: string,
  photo: Blob,
  asked: { prior?: Prior; camera?: Camera; inliers?: boolean; signal?: AbortSignal } = {},
): Promise<Reply> {
  const form = new FormData();
  form.append("image", photo, "photo");
  if (asked.prior) form.append("prior", JSON.stringify(asked.prior));
  if (asked.camera) form.append("camera", JSON.stringify(asked.camera));
  form.append("options", JSON.stringify({ inliers: asked.inliers ?? false }));
  const url = `${gateway.replace(/\/$/, "")}/localise`;
  const response = await fetch(url, { method: "POST", body: form, signal: asked.signal });
  const answer = await response.json();
  if (response.ok) return answer as Reply;
  const wait = response.headers.get("Retry-After");
  throw new GatewayError(answer.code, answer.message, wait === null ? null : Number(wait));
}

// As a program: GATEWAY PHOTO [LATITUDE LONGITUDE SIGMA_M].
declare const process: any;
if ((globalThis as any).process?.argv?.[1]?.endsWith("localise.ts")) {
  const [gateway, file, lat, lon, sigma_m] = process.argv.slice(2);
  const { openAsBlob } = await import("node:fs" as string);
  const prior = sigma_m ? { lat: Number(lat), lon: Number(lon), sigma_m: Number(sigma_m) } : undefined;
  try {
    const reply = await localise(gateway, await openAsBlob(file), { prior });
    console.log(JSON.stringify({ status: reply.status, reason: reply.reason, utm: reply.utm, accuracy: reply.accuracy }));
  } catch (error) {
    console.error(String((error as Error).message));
    process.exitCode = 1;
  }
}
