// A login cookie is not sent when a link from another site is followed; a request of our own shows that it is there.
const { signed_in: isSignedIn } = await (await fetch("/login/state")).json();
if (isSignedIn) location.reload();
