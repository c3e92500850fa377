// Types of client.js. Messages have all fields that /api/v1/asyncapi.json describes; the usual ones are named here.

export type Kind = "event" | "update" | "track" | "arrays" | "alert" | "zone" | "zones" | "poses";

export interface LiveEvent {
  kind: "event";
  id: string;
  time_utc: string | null;
  start_s: number;
  duration_s: number;
  status: "located" | "direction-only" | "refused";
  reason: string | null;
  position_m: [number, number, number] | null;
  covariance_m2: number[][] | null;
  confidence: number;
  arrays: string[];
  zones: string[];
  late: boolean;
  replaces: string[];
  [field: string]: unknown;
}

export interface Gap {
  v: 1;
  kind: "gap";
  missed: number | null;
  reason: string;
}

export interface OtherMessage {
  v: 1;
  kind: "hello" | Exclude<Kind, "event">;
  seq: number;
  [field: string]: unknown;
}

export type Message = LiveEvent | Gap | OtherMessage;

export interface Options {
  /** Gets each message. An error that it throws is reported as an uncaught one, and the client goes on. */
  onMessage: (message: Message) => void;
  /** `live` after each connection, `down` when it is lost, `refused` when the server does not want to try again. */
  onState?: (state: "live" | "down" | "refused", error?: Error | null) => void;
  /** Message kinds; all, and `hello`, if absent. */
  kinds?: Kind[];
  zone?: string;
  minConfidence?: number;
  track?: number;
  maxRateHz?: number;
  /** Access token, where the server wants one. */
  token?: string;
}

/** Follow the live messages of a server, for ever; returns a function that ends it. */
export function follow(url: string, options: Options): () => void;
