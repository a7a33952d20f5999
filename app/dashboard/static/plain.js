// A page that the service has written whole.
import { painted } from "./magcal.js";

await painted();
document.getElementById(location.hash.slice(1))?.scrollIntoView();
